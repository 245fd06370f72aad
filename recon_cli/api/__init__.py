"""Everything that recon does, from Python."""
