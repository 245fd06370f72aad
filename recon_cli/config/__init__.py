"""The options of each stage: one frozen dataclass a stage, and where values come from."""
