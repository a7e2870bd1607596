"""Stability where methods fail: every hazard with every method, and the page that it writes."""
