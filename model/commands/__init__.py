"""The model's commands of `era`: arguments, options and printed reports."""
