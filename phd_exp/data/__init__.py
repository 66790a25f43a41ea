"""From files to batches: images decoded once into a memory-mapped array, batches in a reproducible order."""
