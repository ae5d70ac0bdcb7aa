"""`sfm-app studio`: projects in the browser, for people who use no terminal.

`projects` holds the folders, `jobs` the queue and its processes, `worker` is such a process, and `server` answers the
browser. The server loads neither COLMAP nor photos: the worker writes all that the page shows.
"""
