"""Detection of objects on the track in LiDAR clouds: geofence, ground removal, clustering, cross-check of the size."""
