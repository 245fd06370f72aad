"""Structure from motion: everything that drives pycolmap, in a process of its own.

`process` is what the rest of the package calls. Only `worker`, and what it imports, loads pycolmap:
it is native code that can abort, and then only that process is gone.
"""
