"""Ground commands and parameters, arming, and changes allowed while armed."""
