"""Predictions and truth in; the figures of the field, with their intervals, out."""
