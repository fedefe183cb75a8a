"""The renderer: an airfield and the world around it, drawn exactly through a camera."""
