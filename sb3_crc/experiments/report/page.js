'use strict';
(function () {
  const data = JSON.parse(document.getElementById('data').textContent);
  const root = document.documentElement;
  const AXES = { environment_steps: ['environment steps', 1], seconds: ['hours of training, without evaluations', 3600] };
  let axis = 'environment_steps', single = true;

  const colour = name => getComputedStyle(root).getPropertyValue(name).trim();
  function layout(title, abscissa, ordinate) {
    const line = { gridcolor: colour('--line'), linecolor: colour('--line'), zerolinecolor: colour('--line') };
    return {
      title: { text: title, font: { size: 14 } }, margin: { l: 56, r: 12, t: 36, b: 44 },
      paper_bgcolor: colour('--ground'), plot_bgcolor: colour('--ground'), font: { color: colour('--text'), size: 12 },
      xaxis: { ...line, title: { text: abscissa } }, yaxis: { ...line, title: { text: ordinate }, rangemode: 'tozero' },
      legend: { orientation: 'h', y: -0.2 }, hovermode: 'closest', uirevision: axis + title,
    };
  }
  const mode = values => values.length > 1 ? 'lines' : 'markers';
  const options = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ['lasso2d', 'select2d', 'autoScale2d'] };

  function drawCurves() {
    const [abscissa, unit] = AXES[axis];
    for (const [index, task] of data.tasks.entries()) {
      const traces = [];
      for (const run of single ? task.runs : []) {
        if (!run[axis]) continue;
        traces.push({ x: run[axis].map(x => x / unit), y: run.returns, mode: mode(run.returns), line: { color: data.colours[run.method], width: 1 },
          opacity: 0.45, legendgroup: run.method, showlegend: false, hovertemplate: `${run.method}, seed ${run.seed}: %{y:.0f}<extra></extra>` });
      }
      for (const [method, curve] of Object.entries(task.curves[axis] || {})) {
        const x = curve.x.map(value => value / unit), ours = { legendgroup: method, line: { color: data.colours[method] } };
        if (curve.low) {
          traces.push({ ...ours, x: [...x, ...x.slice().reverse()], y: [...curve.high, ...curve.low.slice().reverse()], fill: 'toself',
            mode: 'lines', line: { width: 0 }, fillcolor: data.colours[method] + '22', showlegend: false, hoverinfo: 'skip' });
        }
        traces.push({ ...ours, x: x, y: curve.y, mode: mode(x), line: { color: data.colours[method], width: 3 },
          name: `${method} (${curve.seeds} ${curve.seeds === 1 ? 'seed' : 'seeds'})`, hovertemplate: `${method}: %{y:.0f}<extra></extra>` });
      }
      Plotly.react('curves-' + index, traces, layout(task.name, abscissa, 'return'), options);
    }
  }

  const metric = document.getElementById('metric');
  function drawInstruments() {
    if (!metric || !metric.value) return;
    const traces = [], named = new Set();
    for (const run of data.instruments) {
      const own = run.values[metric.value];
      if (!own) continue;
      traces.push({ x: own[0].map(step => step * run.action_repeat), y: own[1], mode: 'lines', name: run.method, legendgroup: run.method,
        line: { color: data.colours[run.method], width: 1.5 }, showlegend: !named.has(run.method), hovertemplate: `${run.name}: %{y:.4g}<extra></extra>` });
      named.add(run.method);
    }
    Plotly.react('logged', traces, layout(metric.value, AXES.environment_steps[0], ''), options);
  }

  function draw() { drawCurves(); drawInstruments(); }
  function press(button, on) { button.setAttribute('aria-pressed', String(on)); }
  for (const button of document.querySelectorAll('[data-axis]')) {
    button.addEventListener('click', () => {
      axis = button.dataset.axis;
      document.querySelectorAll('[data-axis]').forEach(other => press(other, other === button));
      drawCurves();
    });
  }
  const each = document.getElementById('each');
  if (each) each.addEventListener('click', () => { single = !single; press(each, single); drawCurves(); });
  if (metric) metric.addEventListener('change', drawInstruments);

  function stored() { try { return localStorage.getItem('sb3-crc-theme'); } catch (error) { return null; } }
  function show(theme) { root.dataset.theme = theme; press(document.getElementById('theme'), theme === 'dark'); draw(); }
  document.getElementById('theme').addEventListener('click', () => {
    const theme = root.dataset.theme === 'dark' ? 'light' : 'dark';
    try { localStorage.setItem('sb3-crc-theme', theme); } catch (error) { /* a page from a file may not keep anything */ }
    show(theme);
  });
  show(stored() || (matchMedia('(prefers-color-scheme: dark)').matches ? 'dark' : 'light'));
})();
