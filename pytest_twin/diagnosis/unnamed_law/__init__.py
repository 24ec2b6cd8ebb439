"""A free law where no effect with a name explains the residual: which variable, what curve."""
