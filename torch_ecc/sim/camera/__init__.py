"""From a scene and its motion to frames: light, optics, sensor, sequences."""
