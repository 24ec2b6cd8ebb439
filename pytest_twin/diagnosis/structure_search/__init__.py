"""Model selection: which effects, at which joints, explain the recordings."""
