"""From a camera's files to frames: decode, choose, measure noise, denoise. Knows no stages."""
