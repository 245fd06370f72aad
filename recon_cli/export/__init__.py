"""`recon import`: a scene that was made elsewhere, in a workspace of its own or with views."""
