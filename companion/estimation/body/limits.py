"""Limits of dead reckoning that the pose gate goes by, too. They import nothing heavy."""

SIGMA_JERK_M_S3 = 10.0
"""Of an acceleration that is taken to stay: a copter that tilts by 60 degrees in a second."""
CONTRADICTS_SIGMAS = 4.0
"""Beyond, a map that is off from inertial navigation is wrong, not navigation; what that was off by
without aid in the firmwares' simulators was 2.5 of them at most."""
