"""Work that is shared out: commands in processes of this machine or on a Ray cluster."""
