"""Where a scene can be trusted: the views of each Gaussian, and the error to expect."""
