"""Stripe images to points."""
