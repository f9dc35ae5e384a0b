"""Basics that the packages of era-haptics share, such as plug-ins and typing suggestions."""
