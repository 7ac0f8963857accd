"""Files: the only room that touches them.

Each module knows one kind of file; all of them write whole files or nothing (`railnav.io.atomic`), turn degrees and
other spelled units into SI and radians at the door, and refuse what they cannot use with the file, the row and the
column.

Modules
-------
atomic : a save leaves the old file or the new one, whole.
tables, xml_document : CSV and Parquet columns, XML without entities, with refusals.
run, run_check, truth, solution : what a train recorded and every defect of it, where it was, where railnav says it was.
gnss_log, nmea, rtklib, ubx, ubx_sensors, gpx, gpsd, bags, tcp_log : receivers' logs, recordings and streams.
logs, log_writers : logs that stand alone, and one made of another, piece by piece.
container, geopackage, qgis_styles : a GeoPackage as layers and tables, the store of a reference track model, how QGIS draws it.
network : a track network from any file; osm, geojson, elements, axis_table, landxml, railml, railml2, layers : from each kind.
design, designed, designs, junctions, drawn : designed alignments laid out as knots, found again in knots; ends joined; drawn lines rounded.
landxml_writer, railml_writer, elements_writer, kml, moving_features : models, designs and solutions for other programs.
"""
