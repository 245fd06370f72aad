"""Structure from motion: everything that drives pycolmap, in a process of its own.

`process` is what the rest of the package calls. Only `worker`, and what it imports, loads pycolmap:
it is native code that can abort, and then only that process is gone.
"""

# The pycolmap wheel brings a zlib whose functions get mixed up with those of the system's zlib
# where pycolmap happens to load that one first: the next PNG that Pillow, OpenCV or Python packs
# then aborts with "free(): invalid pointer". Loading zlib before pycolmap keeps the two apart.
import zlib as zlib
