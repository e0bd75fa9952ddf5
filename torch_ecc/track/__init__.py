"""The tracker: the only state, from frame to frame."""
