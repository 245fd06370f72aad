"""LZFSE, Apple's compression, which Record3D packs depth and confidence with.

The package `lzfse` decodes it. Sizes are checked before, block by block, because the decoder
allocates whatever a damaged stream says (github.com/lzfse/lzfse, src/lzfse_internal.h).
"""

from __future__ import annotations

import struct

_END = b"bvx$"
_WORDS = struct.Struct("<II")


def decompress(data: bytes, size: int) -> bytes:
    """Returns the decoded bytes, `size` of them; ValueError if there are others or damaged ones."""
    count = decoded_size(data)
    if count != size:
        raise ValueError(f"it holds {count} bytes, needed {size}")
    import lzfse

    try:
        decoded = bytes(lzfse.decompress(data))
    except lzfse.error as error:
        raise ValueError("its LZFSE stream is damaged") from error
    if len(decoded) != size:
        raise ValueError(f"it holds {len(decoded)} bytes, needed {size}")
    return decoded


def decoded_size(data: bytes) -> int:
    """Returns the bytes that the blocks of a stream say they hold; ValueError if it is cut."""
    at, total = 0, 0
    while data[at:at + 4] != _END:
        kind = data[at:at + 4]
        try:
            raw, packed = _WORDS.unpack_from(data, at + 4)
            if kind == b"bvx-":  # stored
                at += 8 + raw
            elif kind == b"bvxn":  # LZVN
                at += 12 + packed
            elif kind == b"bvx2":  # LZFSE with a packed header
                fields = struct.unpack_from("<QQQ", data, at + 8)
                literals, matches = fields[0] >> 20 & 0xFFFFF, fields[1] >> 40 & 0xFFFFF
                header = fields[2] & 0xFFFFFFFF
                if header < 32:  # its fields alone; it would never end
                    raise ValueError("its LZFSE stream is damaged")
                at += header + literals + matches
            elif kind == b"bvx1":  # LZFSE with a plain header, of 772 bytes
                literals, matches = struct.unpack_from("<II", data, at + 20)
                at += 772 + literals + matches
            else:
                raise ValueError("it is not an LZFSE stream, or cut short")
        except struct.error as error:
            raise ValueError("its LZFSE stream is cut short") from error
        total += raw
    return total
