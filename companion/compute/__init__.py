"""The OpenCL devices of this computer: tried in processes of their own, chosen, remembered on disk.

Above `dense`, whose kernels are what is tried; below the stages that need a device.
"""
