"""Label files, crops and the scene renderer: foreign conventions are converted here and nowhere else."""
