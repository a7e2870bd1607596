"""The farm's workers: take tasks, run the renderer in a child process, merge the partial images."""
