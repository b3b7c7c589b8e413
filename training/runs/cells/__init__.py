"""Scenes too large for one run: plan cells, train each as an ordinary run, and merge the results."""
