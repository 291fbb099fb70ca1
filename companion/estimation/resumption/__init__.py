"""Maps of the process before: kept as checkpoints, recognised, gone on with."""
