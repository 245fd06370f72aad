"""Dense stereo: depth from the images themselves, for training and for meshes."""
