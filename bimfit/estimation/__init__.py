"""From a match to an estimate: posterior, motion along the joint, status."""
