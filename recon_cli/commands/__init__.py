"""Commands: one file a verb, from click options to one call. Loaded only when typed."""
