"""GRCSM and the matchers it is compared with."""
