"use strict";
// Draws the figures of the page, and moves the train in the plan while the pointer moves over a chart along time.
(function () {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  // The buttons are named one by one: plotly.js has others, some versions one that uploads the chart to its maker.
  const config = {
    responsive: true,
    displaylogo: false,
    showLink: false,
    showSendToCloud: false,
    showEditInChartStudio: false,
    sendData: false,
    plotlyServerURL: "",
    topojsonURL: "",
    modeBarButtons: [["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]],
    toImageButtonOptions: { format: "svg" },
  };
  const drawn = {};
  for (const figure of figures) {
    const place = document.getElementById(figure.id);
    drawn[figure.id] = Plotly.newPlot(place, figure.data, figure.layout, config);
    place.figure = figure;
  }
  const plan = document.getElementById("plan");
  const marker = plan && plan.figure.marker;
  if (!marker) return;
  const nearest = function (times, time) {
    let low = 0, high = times.length - 1;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (times[middle] < time) low = middle + 1; else high = middle;
    }
    return low > 0 && time - times[low - 1] < times[low] - time ? low - 1 : low;
  };
  for (const figure of figures) {
    const along = marker.places ? marker.places[figure.id] : marker;
    if (!figure.moves || !along) continue;
    drawn[figure.id].then(function (place) {
      place.on("plotly_hover", function (event) {
        const k = nearest(along.time, event.points[0].x);
        Plotly.restyle(plan, { x: [[along.x[k]]], y: [[along.y[k]]] }, [marker.trace]);
      });
    });
  }
})();
