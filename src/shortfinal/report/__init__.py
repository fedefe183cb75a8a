"""An evaluation as pictures and as a page that people read."""
