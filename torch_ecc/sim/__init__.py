"""Simulators: scenes, motion, camera (truth is made here, never with the tracker's own interpolation)."""
