"""Live cameras, each behind one method: see ``newest.Camera``."""
