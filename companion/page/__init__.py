"""The page on the drone: a process of its own, which asks the daemon as `companion status` does."""
