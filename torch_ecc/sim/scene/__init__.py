"""Scenes: analytic, so that their truth needs no interpolation."""
