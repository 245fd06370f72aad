"""`recon prune --sweep`: what every score costs at every ratio, against controls."""
