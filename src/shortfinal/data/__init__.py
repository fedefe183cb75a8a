"""Data sets: read, written, fetched, checked, rendered. Foreign conventions are converted here and nowhere else."""
