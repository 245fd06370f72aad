"""Runs recon commands for other programs: in processes of this machine, or on a Ray cluster."""
