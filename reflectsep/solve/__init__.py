"""Batched Gauss-Newton / Levenberg-Marquardt. Generic: knows no light and no image."""
