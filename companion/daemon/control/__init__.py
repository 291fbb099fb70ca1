"""Ground commands and parameters, arming, and what may change while the motors are armed."""
