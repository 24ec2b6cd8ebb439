"""What the plugin does once a twin is there: items, plans, verdicts. Loaded only then."""
