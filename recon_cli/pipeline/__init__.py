"""Which stages run, in what order, and how one stage is run and committed."""
