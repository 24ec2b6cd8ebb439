"""Residuals and online updates beside a base model, tried in its shadow before they are used."""
