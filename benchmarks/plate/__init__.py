"""Speed and accuracy of the plate model beside other programs."""
