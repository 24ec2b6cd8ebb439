"""Contact parameters of a free object from its measured tosses."""
