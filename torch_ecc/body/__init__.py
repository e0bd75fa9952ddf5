"""Rigid bodies of many patches, the lens that sees them, and what their moves tell of the camera."""
