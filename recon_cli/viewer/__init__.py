"""`recon view` and `recon train --view`: Gaussians in the browser, through viser."""
