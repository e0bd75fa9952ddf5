"""Templates that are not where they are expected: near there, or anywhere in the frame at any angle."""
