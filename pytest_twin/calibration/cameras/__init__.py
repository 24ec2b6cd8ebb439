"""Cameras: projection, poses and intrinsics from detected corners, reprojection residuals."""
