"""The map over zenoh: keys, messages, queryables."""
