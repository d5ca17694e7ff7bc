"""The as-built gap: polygon, widths, mesh, volume, files."""
