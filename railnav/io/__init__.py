"""Files: the only room that touches them.

Each module knows one kind of file; all of them write whole files or nothing (`railnav.io.atomic`), turn degrees and
other spelled units into SI and radians at the door, and refuse what they cannot use with the file, the row and the
column.

Modules
-------
atomic : a save leaves the old file or the new one, whole.
tables : CSV and Parquet columns, with refusals.
run, truth, solution : what a train recorded, where it was, where railnav says it was.
container : a GeoPackage as a container of layers and tables.
geopackage : the store of a reference track model.
geojson, elements : track networks to import, and back.
"""
