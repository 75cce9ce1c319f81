"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  const json = (id) => JSON.parse(byId(id).textContent);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // Charts: sizes and transparent grounds here; colours of text and grid come from the style sheet.
  const font = { family: "system-ui, -apple-system, 'Segoe UI', Roboto, 'Liberation Sans', Arial, sans-serif", size: 12 };
  const quiet = { displayModeBar: false, responsive: true };
  const charts = json("charts-data");
  // Plots side by side need space for their titles: two in a row on a narrow screen.
  const narrowed = (layout, place) => {
    if (!layout.grid || layout.grid.columns < 3 || place.clientWidth > 560) return;
    const count = Object.keys(layout).filter((key) => key.startsWith("xaxis")).length;
    const title = layout.yaxis.title.text;
    layout.grid.columns = 2;
    layout.grid.rows = Math.ceil(count / 2);
    for (let k = 0; k < count; k++) {
      const suffix = k ? k + 1 : "";
      layout[`yaxis${suffix}`].title.text = k % 2 ? "" : title;
      layout[`xaxis${suffix}`].title.font = { size: 11 };
    }
    place.style.height = `${60 + 210 * layout.grid.rows}px`;
  };
  const layoutOf = (chart, place) => {
    const layout = structuredClone(chart.layout);
    narrowed(layout, place);
    const margin = { l: 58, r: 12, t: 30, b: 48 };
    Object.assign(layout, { font, margin, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", autosize: true, hovermode: "closest" });
    layout.hoverlabel = { bgcolor: "#2b3440", bordercolor: "#2b3440", font: { ...font, color: "#ffffff" } };
    layout.legend = { orientation: "h", y: 1, yanchor: "bottom", x: 0, bgcolor: "rgba(0,0,0,0)" };
    return layout;
  };
  for (const chart of charts) {
    const place = byId(chart.id);
    if (place) Plotly.newPlot(place, chart.data, layoutOf(chart, place), quiet);
  }

  // The 3D view.
  const scene = json("scene-data");
  const place = byId("view3d");
  if (scene && place) {
    const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    // The numbers are little-endian in the page, whatever the machine is.
    const floats = (text) => { const b = bytes(text), v = new DataView(b.buffer); return Float32Array.from({ length: b.length / 4 }, (_, k) => v.getFloat32(4 * k, true)); };
    const shorts = (text) => { const b = bytes(text), v = new DataView(b.buffer); return Uint16Array.from({ length: b.length / 2 }, (_, k) => v.getUint16(2 * k, true)); };
    const axis = (points, k) => Float32Array.from({ length: points.length / 3 }, (_, i) => points[3 * i + k]);
    const quantile = (values, fraction) => { const sorted = Float64Array.from(values).sort(); return sorted.length ? sorted[Math.round(fraction * (sorted.length - 1))] : 0; };
    const views = {};
    let rgb, images, limit = 1;
    if (scene.map) {
      const colors = bytes(scene.map.colors);
      rgb = Array.from({ length: scene.map.points }, (_, k) => `rgb(${colors[3 * k]},${colors[3 * k + 1]},${colors[3 * k + 2]})`);
      images = shorts(scene.map.postures);
      for (const rig of ["nominal", "calibrated"]) {
        const points = floats(scene.map[rig + "_m"]);
        views[rig] = { x: axis(points, 0), y: axis(points, 1), z: axis(points, 2), distance: floats(scene.map[`point_to_plane_${rig}_mm`]) };
      }
      // One scale for both, so that the switch shows the difference.
      limit = Math.max(quantile(views.nominal.distance.filter((v) => !Number.isNaN(v)), 0.9), quantile(views.calibrated.distance.filter((v) => !Number.isNaN(v)), 0.9), 0.1);
    }
    // A few stray points must not make the rest small.
    const range = (k) => {
      const name = "xyz"[k];
      const cameras = scene.calibrated.concat(scene.nominal).map((p) => p[k]);
      const points = scene.map ? ["nominal", "calibrated"].flatMap((rig) => [quantile(views[rig][name], 0.004), quantile(views[rig][name], 0.996)]) : [];
      const low = Math.min(...cameras, ...points), high = Math.max(...cameras, ...points);
      const margin = 0.03 * (high - low) + 0.01;
      return [low - margin, high + margin];
    };
    const ranges = [0, 1, 2].map(range);
    const home = { eye: { x: 1.15, y: -1.25, z: 0.75 }, center: { x: 0, y: 0, z: -0.08 }, up: { x: 0, y: 0, z: 1 } };
    const choice = (name) => document.querySelector(`input[name="${name}"]:checked`)?.value;
    const cloud = (rig) => {
      const view = views[rig];
      const base = { type: "scatter3d", mode: "markers", name: "map", x: view.x, y: view.y, z: view.z, hoverinfo: "skip", showlegend: false };
      switch (choice("color")) {
        case "image":
          return [{ ...base, marker: { size: 1.6, color: images, colorscale: "Viridis", cmin: 0, cmax: scene.calibrated.length - 1, showscale: true, colorbar: bar("image (position in the recording)") } }];
        case "distance": {
          const compared = [], alone = [];
          view.distance.forEach((v, k) => (Number.isNaN(v) ? alone : compared).push(k));
          const part = (keep) => ({ ...base, x: keep.map((k) => view.x[k]), y: keep.map((k) => view.y[k]), z: keep.map((k) => view.z[k]) });
          return [
            { ...part(alone), marker: { size: 1.2, color: color("--line") } },
            { ...part(compared), marker: { size: 1.8, color: compared.map((k) => view.distance[k]), colorscale: "Cividis", cmin: 0, cmax: limit, showscale: true, colorbar: bar("point to plane (mm)") } },
          ];
        }
        default:
          return [{ ...base, marker: { size: 1.8, color: rgb } }];
      }
    };
    const bar = (text) => ({ title: { text, side: "right" }, thickness: 10, len: 0.8, outlinewidth: 0, x: 0.99, xanchor: "right", tickfont: { ...font, size: 11 } });
    const path = (rig, points, tint, symbol) => ({
      type: "scatter3d", mode: "lines+markers", name: `camera, ${rig}`, x: points.map((p) => p[0]), y: points.map((p) => p[1]), z: points.map((p) => p[2]),
      text: scene.indices.map((i) => `posture ${i}`), hovertemplate: "%{text}<br>%{x:.3f}, %{y:.3f}, %{z:.3f} m<extra></extra>",
      line: { color: tint, width: 2 }, marker: { size: 3, color: tint, symbol },
    });
    const axes = (text, line) => Object.fromEntries([0, 1, 2].map((k) => [`${"xyz"[k]}axis`, { title: { text: `${"xyz"[k]} (m)` }, range: ranges[k], color: text, gridcolor: line, zerolinecolor: line, showbackground: false, showspikes: false }]));
    // Paper shows an image, as what a graphics card drew cannot be printed; always dark on white.
    const image = new Image();
    image.className = "paper";
    image.alt = "The 3D view";
    let asked = 0;
    const snapshot = async (delay = 700) => {
      const mine = ++asked;
      await new Promise((done) => setTimeout(done, delay));
      if (mine !== asked) return;
      const layout = { ...place.layout, width: 900, height: 480, autosize: false, paper_bgcolor: "#ffffff", font: { ...font, size: 12, color: "#000000" } };
      layout.scene = { ...place.layout.scene, ...axes("#000000", "#bbbbbb"), camera: place._fullLayout.scene.camera };
      const url = await Plotly.toImage({ data: place.data, layout }, { format: "jpeg", width: 900, height: 480, scale: 1.5 });
      if (mine === asked) {
        image.src = url;
        await image.decode().catch(() => {});
        if (!image.isConnected) place.after(image);
        hasty?.remove();
      }
    };
    // Whoever prints before that image is there gets what the screen shows, taken over at once.
    let hasty = null;
    addEventListener("beforeprint", () => {
      const glplot = place._fullLayout?.scene?._scene?.glplot;
      if (image.isConnected || !glplot) return;
      glplot.redraw();
      const shown = glplot.gl.canvas;
      hasty?.remove();
      hasty = document.createElement("canvas");
      hasty.className = "paper";
      hasty.width = shown.width;
      hasty.height = shown.height;
      const context = hasty.getContext("2d");
      context.fillStyle = "#ffffff";
      context.fillRect(0, 0, hasty.width, hasty.height);
      context.drawImage(shown, 0, 0);
      place.after(hasty);
    });
    const draw = () => {
      const rig = choice("poses") || "calibrated";
      const tint = { nominal: color("--nominal"), calibrated: color("--calibrated") };
      const symbol = { nominal: "diamond", calibrated: "circle" };
      const data = scene.map ? [...cloud(rig), path(rig, scene[rig], tint[rig], symbol[rig])] : [path(rig, scene[rig], tint[rig], symbol[rig])];
      const text = color("--text"), line = color("--line");
      const layout = {
        font: { ...font, size: 11, color: text }, margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: "rgba(0,0,0,0)", autosize: true, uirevision: "same",
        hoverlabel: { bgcolor: "#2b3440", font: { ...font, color: "#ffffff" } },
        legend: { x: 0.01, y: 0.99, bgcolor: "rgba(0,0,0,0)" }, showlegend: true,
        scene: { ...axes(text, line), domain: { x: [0, (choice("color") || "photo") === "photo" ? 1 : 0.87] }, aspectmode: "data", camera: home, dragmode: "orbit", uirevision: "same" },
      };
      const said = byId("scene-said");
      if (said) said.textContent = `Shown: ${rig} poses${scene.map ? `, coloured by ${{ photo: "photograph", image: "image", distance: "depth consistency (point to plane)" }[choice("color")]}` : ""}.`;
      // The first image soon, later ones when the hand rests.
      snapshot(asked ? 700 : 50);
      return Plotly.react(place, data, layout, { displayModeBar: false, responsive: true });
    };
    draw().then(() => place.on("plotly_relayout", () => snapshot()));
    document.querySelectorAll(".switches input").forEach((input) => input.addEventListener("change", draw));
    dark.addEventListener("change", draw);

    // The keyboard turns it as the mouse does.
    const turn = (dx, dy, nearer) => {
      const { eye, center, up } = place._fullLayout.scene._scene.getCamera();
      const radius = Math.hypot(eye.x, eye.y, eye.z) * nearer;
      const azimuth = Math.atan2(eye.y, eye.x) + dx;
      const height = Math.min(1.5, Math.max(-1.5, Math.asin(Math.max(-1, Math.min(1, eye.z / Math.hypot(eye.x, eye.y, eye.z)))) + dy));
      const flat = radius * Math.cos(height);
      Plotly.relayout(place, { "scene.camera": { eye: { x: flat * Math.cos(azimuth), y: flat * Math.sin(azimuth), z: radius * Math.sin(height) }, center, up } });
    };
    const step = Math.PI / 18;
    const keys = { ArrowLeft: [-step, 0, 1], ArrowRight: [step, 0, 1], ArrowUp: [0, step, 1], ArrowDown: [0, -step, 1], "+": [0, 0, 0.85], "=": [0, 0, 0.85], "-": [0, 0, 1 / 0.85] };
    place.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "0") Plotly.relayout(place, { "scene.camera": home });
      else if (keys[event.key]) turn(...keys[event.key]);
      else return;
      event.preventDefault();
    });
  }

  // The command that repeats the run, with the folder that the page lies in.
  const folder = byId("result-folder");
  if (folder && location.protocol === "file:") {
    const here = decodeURIComponent(location.pathname).replace(/^\/([A-Za-z]:)/, "$1").replace(/\/[^/]*$/, "");
    if (here) folder.textContent = /^[\w\-./+:,=@%]+$/.test(here) ? here : `'${here.replaceAll("'", "'\\''")}'`;
  }

  // Paper: charts as wide as the page and lower than on the screen, whatever that was, so that pages fill.
  const paper = (on) => {
    for (const plot of document.querySelectorAll(".plot")) {
      if (!plot._fullLayout || plot.id === "view3d") continue;
      if (on) {
        plot.dataset.height = plot.style.height;
        const wanted = parseFloat(plot.style.height) * 0.7;
        const most = parseFloat(plot.style.maxWidth) || Infinity;
        plot.style.height = `${wanted}px`;
        Plotly.relayout(plot, { width: plot.closest(".pair") ? 330 : Math.min(670, most * 0.85), height: wanted });
      } else {
        plot.style.height = plot.dataset.height;
        Plotly.relayout(plot, { width: undefined, height: undefined, autosize: true });
      }
    }
  };
  addEventListener("beforeprint", () => { document.querySelectorAll("details").forEach((d) => { d.dataset.was = d.open ? "1" : ""; d.open = true; }); paper(true); });
  addEventListener("afterprint", () => { document.querySelectorAll("details").forEach((d) => { d.open = d.dataset.was === "1"; }); paper(false); });
})();
