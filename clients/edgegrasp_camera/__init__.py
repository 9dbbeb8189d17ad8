"""What a depth camera gives: depth images, PointCloud2, files of clouds, and poses; numpy alone."""
