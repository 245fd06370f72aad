"""A long walk in segments: each mapped alone, then joined, and bent so that its loops close."""
