"""Speed and accuracy of the plate model, compared with other programs."""
