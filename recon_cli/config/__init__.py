"""What each stage can be told: one frozen dataclass a stage, and where values come from."""
