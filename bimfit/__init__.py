"""bimfit: what a building joint really looks like."""

__version__ = "0.1.0"
