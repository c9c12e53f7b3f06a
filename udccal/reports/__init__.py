"""Reports: collects numbers, draws figures, writes HTML."""
