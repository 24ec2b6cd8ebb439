"""The semantic-loss matrix: what a conversion keeps, changes and loses."""
