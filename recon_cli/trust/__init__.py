"""Where a scene can be trusted: what each Gaussian is seen from, and the error to expect."""
