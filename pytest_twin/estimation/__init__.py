"""Estimation: hypotheses, their least squares, scores and covariances, for every room that fits."""
