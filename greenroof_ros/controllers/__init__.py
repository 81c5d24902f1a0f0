"""The controllers, each in its own module."""
