"""OpenCL devices of this computer: tested in separate processes, selected, cached on disk.

Above `dense`, whose kernels are tested; below the stages that need a device.
"""
