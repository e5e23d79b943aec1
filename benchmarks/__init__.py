"""Estimators of the fundamental matrix side by side, on real pairs and on made-up scenes."""
