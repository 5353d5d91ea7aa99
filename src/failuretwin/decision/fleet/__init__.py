"""Many robots behind a broker: alarms in batches, partitions, and the workers that hold them."""
