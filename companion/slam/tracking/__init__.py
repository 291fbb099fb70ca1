"""The tracking state machine: pose of each frame, keyframe decision, map initialisation."""
