import pytest
from media import texture, write_video

from recon_cli.capture.container_probe import codec_name, lacks_index


@pytest.fixture(scope="module")
def mp4(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("mp4") / "a.mp4", [texture(64, 96)] * 5).read_bytes()


@pytest.mark.parametrize(("fourcc", "name"), [
    (b"avc1", "avc1"), (b"av01", "AV1"), (b"hvc1", "HEVC"), (b"dvh1", "HEVC"), (b"xy z", "xy z")])
def test_an_mp4_names_its_codec_by_four_letters(tmp_path, mp4, fourcc, name):
    path = tmp_path / "a.mp4"
    path.write_bytes(mp4.replace(b"avc1", fourcc))
    assert codec_name(path) == name


@pytest.mark.parametrize(("suffix", "codec", "name"), [
    (".mkv", "libx264", "V_MPEG4/ISO/AVC"), (".avi", "mpeg4", "FMP4"), (".ts", "libx264", "")])
def test_other_containers_name_it_in_their_own_way_or_not_at_all(tmp_path, suffix, codec, name):
    path = write_video(tmp_path / f"a{suffix}", [texture(64, 96)] * 5, codec=codec)
    assert codec_name(path) == name


def test_an_mp4_has_its_index_until_a_byte_of_it_is_missing(tmp_path, mp4):
    path = tmp_path / "a.mp4"
    end = mp4.index(b"moov") - 4 + int.from_bytes(mp4[mp4.index(b"moov") - 4:][:4])
    for length, lacking in ((end, False), (end - 1, True), (len(mp4) // 2, True), (9, True)):
        path.write_bytes(mp4[:length])
        assert lacks_index(path) is lacking, length


@pytest.mark.parametrize("content", [b"", b"text\n" * 50, bytes(5000), b"RIFF\0\0\0\0AVI LIST"])
def test_what_is_no_mp4_lacks_no_index(tmp_path, content):
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    assert lacks_index(path) is False


def test_a_length_of_64_bits_and_one_to_the_end_are_understood(tmp_path):
    path = tmp_path / "a.mp4"
    long = (1).to_bytes(4) + b"mdat" + (100).to_bytes(8) + bytes(84)
    path.write_bytes(long + bytes(4) + b"moov" + bytes(20))
    assert lacks_index(path) is False
    path.write_bytes(long + (200).to_bytes(4) + b"moov" + bytes(20))
    assert lacks_index(path) is True
