"""The commands about site maps: shown, verified, merged, compared."""
