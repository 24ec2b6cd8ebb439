"""The semantic-loss matrix: features that a conversion keeps, changes or loses."""
