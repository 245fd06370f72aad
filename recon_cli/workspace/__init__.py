"""The folder that holds every result: layout, manifests, digests, lock, atomic writes."""
