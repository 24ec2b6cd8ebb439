"""Identification of the contact parameters of a free object from measured tosses."""
