"""The audit of an SRDF: planning groups, poses and disabled pairs against the URDF they name."""
