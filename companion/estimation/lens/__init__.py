"""The lens: whether its focal length fits how the images turn."""
