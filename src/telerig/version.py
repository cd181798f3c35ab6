"""The version of this installation."""

VERSION = "0.2.0"
