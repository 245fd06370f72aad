"""`recon study`: the paper's experiment, repeated over seeds, with intervals."""
