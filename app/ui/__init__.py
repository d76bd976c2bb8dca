"""The page: one session per browser, its tabs, charts and clips."""
