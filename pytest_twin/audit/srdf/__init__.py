"""Audit an SRDF: compare its planning groups, poses and disabled pairs with its URDF."""
