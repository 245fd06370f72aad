"""The fit of one model: its task, state, steps, losses and densification."""
