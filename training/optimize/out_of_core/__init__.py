"""Training of models larger than memory: rows on disk, a cache of cuts and an order of nearby views."""
