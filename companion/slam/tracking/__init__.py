"""The tracking state machine: from a frame to its pose, and to the choice of keyframes."""
