"""`recon eval A B C`: models of several workspaces and splat files in one table."""
