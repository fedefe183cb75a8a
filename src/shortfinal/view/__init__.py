"""A flight to look at: the replay page of a results folder, and the same page live."""
