"""The whole way from a model and a scan to the as-built gap: reads like the paper, a step a line."""
