"""The benchmark: data sets with checksums, tasks, tracks, entries and their scores."""
