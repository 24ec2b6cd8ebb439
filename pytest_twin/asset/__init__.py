"""Convert the supplier's files to realizations, and report what each conversion changed or lost."""
