"""Structure from motion: everything that drives pycolmap, in a process of its own.

`process` is what the rest of the package calls. Only `worker`, and what it imports, loads pycolmap:
it is native code that can abort, and then only that process is gone.
"""

# pycolmap's wheel brings a zlib that gets mixed up with the system's where pycolmap loads first:
# packing a PNG then aborts with "free(): invalid pointer". Loading zlib before keeps them apart.
import zlib as zlib
