"""Reports for people: failure texts, plots, HTML pages."""
