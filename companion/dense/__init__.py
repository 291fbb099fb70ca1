"""Dense depth of a keyframe on OpenCL, and its fusion into a cloud. Pure: no I/O, no clock."""
