"""The page's views: the routes of each, and the parts that all share (`site.py`)."""
