"""The optional parts of the model: a module and a row of `table` each, and one runner of trials."""
