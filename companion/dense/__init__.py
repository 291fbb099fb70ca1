"""Dense multi-view stereo on OpenCL: plane sweep, regularisation, consistency, fusion."""
