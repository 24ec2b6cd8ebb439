"""Records of estimations: the inputs that each was made from, and whether they are unchanged."""
