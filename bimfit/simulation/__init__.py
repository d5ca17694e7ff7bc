"""Random joints with known truth, and a virtual rangefinder."""
