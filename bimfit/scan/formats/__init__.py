"""A file a format, one registry."""
