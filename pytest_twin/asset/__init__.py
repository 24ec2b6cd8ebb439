"""From the supplier's files to realizations that can be trusted, and what each conversion lost."""
