// Project splats to ellipses on the image, and propagate the ellipses' gradients to the splats' parameters.
//
// Notation: p = R m + t the mean in camera coordinates, M = R Q diag(s) with covariance M Mt, J the Jacobian of
// (fx x/z, fy y/z) at p (clamped to a frustum a little wider than the image), cov = J M Mt Jt + dilation (EWA
// splatting, Zwicker et al. 2001, as in 3DGS Eq. 5). u and v are the rows of J M.

struct View {
    pose: array<vec4f, 3>,  // world to camera, row by row
    position: vec4f,  // camera centre in the world
    focal: vec2f,
    center: vec2f,
    low: vec2f,  // x/z and y/z are clamped from low to high in the Jacobian
    high: vec2f,
    size: vec2f,  // of the image in pixels
    near: f32,
    min_scale: f32,
    count: u32,
    degree: u32,  // active degree of the harmonics
    terms: u32,  // number of coefficients
    first: u32,  // index of the first splat
    keep_m: f32,  // Adam's betas
    keep_v: f32,
    eps: f32,
    shrink: f32,  // factor by which the photo was downscaled; 0 collects no statistics
    drawn_only: f32,  // if positive, splats of weight 0 keep their values and moments
    sparse_sh: f32,  // if positive, so do harmonics of splats outside the image
    // learning rate and scale of second moments, for the trained numbers of a splat and its coefficients
    rates: array<vec4f, 43>,
}
@group(0) @binding(0) var<uniform> u: View;
@group(0) @binding(1) var<storage, read_write> splats: array<f32>;  // (M, SPLAT)
@group(0) @binding(2) var<storage, read_write> sh: array<f32>;  // (M, terms, 3)
@group(0) @binding(3) var<storage, read_write> rows: array<Row>;
@group(0) @binding(4) var<storage, read_write> colors: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> depths: array<u32>;
@group(0) @binding(6) var<storage, read_write> radii: array<f32>;
@group(0) @binding(7) var<storage, read_write> order: array<u32>;
@group(0) @binding(8) var<storage, read> projected: array<Row>;
@group(0) @binding(9) var<storage, read> sums: array<f32>;  // (M, PAIR_SUMS)
@group(0) @binding(10) var<storage, read_write> by_splats: array<f32>;  // (M, BY_SPLAT)
@group(0) @binding(11) var<storage, read_write> by_sh: array<f32>;  // (M, terms, 3)
@group(0) @binding(12) var<storage, read_write> moments: array<vec2f>;  // (M, TRAINED + 3 terms): first and second
@group(0) @binding(13) var<storage, read_write> stats: array<f32>;  // (M, STATS)
@group(0) @binding(14) var<storage, read> report: array<u32>;

// Columns of splats: mean, opacity logit, quaternion, log-scales, weight, and Mip-Splatting filter flag. Columns of
// by_splats: gradients of the first twelve, grad2d and absgrad2d.
const SPLAT: u32 = 13;
const BY_SPLAT: u32 = 16;
const TRAINED: u32 = 11;  // first columns, which Adam changes
const LOGIT: u32 = 3;
const WEIGHT: u32 = 11;
const BY_MEAN2D: u32 = 12;
// Columns of stats, in the order of STATS in device_model.py.
const GRADIENT_SUM: u32 = 0;
const SEEN: u32 = 1;
const GRADIENT_MAX: u32 = 2;
const RADIUS_MAX: u32 = 3;
const OPACITY_SUM: u32 = 4;
const STATS: u32 = 5;
// Smaller moments are set to zero, as on the CPU.
const M_TINY: f32 = 1e-30;
const V_TINY: f32 = 1e-36;

// Gradients of the splats of a workgroup.
var<workgroup> splat_gradients: array<f32, LANES * TRAINED>;
var<workgroup> bases: array<f32, LANES * 25>;
var<workgroup> colour_gradients: array<vec3f, LANES>;

struct Axes {
    turned: mat3x3f,  // R Q
    scale: vec3f,
    quat: vec4f,  // unit length, as x, y, z, w
    per_length: f32,
}

struct Ellipse {
    u: vec3f,
    v: vec3f,
    jacobian: vec4f,  // j0, j2 of its first row, and k1, k2 of its second
    uu: f32,
    uv: f32,
    vv: f32,
    cross: vec3f,  // u x v: its square is the determinant before dilation, without cancellation for needles
}

fn triple(first: u32) -> vec3f {
    return vec3f(splats[first], splats[first + 1u], splats[first + 2u]);
}

fn to_camera(mean: vec3f) -> vec3f {
    let m = vec4f(mean, 1.0);
    return vec3f(dot(u.pose[0], m), dot(u.pose[1], m), dot(u.pose[2], m));
}

fn camera_rotation() -> mat3x3f {
    return transpose(mat3x3f(u.pose[0].xyz, u.pose[1].xyz, u.pose[2].xyz));
}

fn sigmoid(x: f32) -> f32 {
    let e = exp(-abs(x));
    return select(e, 1.0, x >= 0.0) / (1.0 + e);
}

fn axes_of(first: u32) -> Axes {
    let raw = vec4f(triple(first + 5u), splats[first + 4u]);
    let per_length = 1.0 / sqrt(dot(raw, raw));
    let q = raw * per_length;
    let rotation = mat3x3f(  // column by column
        vec3f(1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y + q.w * q.z), 2.0 * (q.x * q.z - q.w * q.y)),
        vec3f(2.0 * (q.x * q.y - q.w * q.z), 1.0 - 2.0 * (q.x * q.x + q.z * q.z), 2.0 * (q.y * q.z + q.w * q.x)),
        vec3f(2.0 * (q.x * q.z + q.w * q.y), 2.0 * (q.y * q.z - q.w * q.x), 1.0 - 2.0 * (q.x * q.x + q.y * q.y)),
    );
    return Axes(camera_rotation() * rotation, exp(triple(first + 8u)) + u.min_scale, q, per_length);
}

fn ellipse_of(p: vec3f, axes: Axes) -> Ellipse {
    let per_z = 1.0 / p.z;
    let ratio = clamp(p.xy * per_z, u.low, u.high);
    let j = vec4f(u.focal.x * per_z, -u.focal.x * ratio.x * per_z, u.focal.y * per_z, -u.focal.y * ratio.y * per_z);
    let m = transpose(axes.turned);  // its columns are the rows of R Q
    let row_u = (j.x * m[0] + j.y * m[2]) * axes.scale;
    let row_v = (j.z * m[1] + j.w * m[2]) * axes.scale;
    return Ellipse(
        row_u, row_v, j, dot(row_u, row_u), dot(row_u, row_v), dot(row_v, row_v), cross(row_u, row_v),
    );
}

@compute @workgroup_size(LANES)
fn forward(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i >= u.count) { return; }
    depths[i] = 0xffffffffu;
    order[i] = u.first + i;
    rows[i].radius = 0.0;
    radii[i] = 0.0;
    let first = i * SPLAT;
    let mean = triple(first);
    let p = to_camera(mean);
    var opacity = splats[first + 11u] * sigmoid(splats[first + 3u]);
    if (!(p.z > u.near) || !(opacity > ALPHA_MIN)) { return; }
    let e = ellipse_of(p, axes_of(first));
    let filtered = splats[first + 12u] > 0.0;
    let dilation = select(DILATION, MIP_VARIANCE, filtered);
    let undilated = dot(e.cross, e.cross);
    let determinant = undilated + dilation * (e.uu + e.vv + dilation);
    if (filtered) {
        opacity *= sqrt(undilated / determinant);
        if (!(opacity > ALPHA_MIN)) { return; }
    }
    let xx = e.uu + dilation;
    let yy = e.vv + dilation;
    let middle = u.focal * p.xy / p.z + u.center;
    let half_size = sqrt(2.0 * log(opacity / ALPHA_MIN)) * sqrt(vec2f(xx, yy));
    if (!(all(middle + half_size > vec2f(0.0)) && all(middle - half_size < u.size))) { return; }  // also if NaN
    let half_difference = 0.5 * (xx - yy);
    let longest = 0.5 * (xx + yy) + sqrt(half_difference * half_difference + e.uv * e.uv);
    let radius = 3.0 * sqrt(longest);
    let conic = vec3f(yy, -e.uv, xx) / determinant;
    radii[i] = radius;
    depths[i] = bitcast<u32>(p.z);

    var values: array<f32, 25>;
    basis(normalize(mean - u.position.xyz), u.degree, &values);
    var color = vec3f(0.5);
    for (var k = 0u; k < active_terms(); k++) {
        let at = (i * u.terms + k) * 3u;
        color += values[k] * vec3f(sh[at], sh[at + 1u], sh[at + 2u]);
    }
    colors[i] = vec4f(max(color, vec3f(0.0)), 0.0);
    let positive = vec3u(color > vec3f(0.0));
    let channels = positive.x | positive.y << 1u | positive.z << 2u;
    rows[i] = Row(middle, half_size, conic, log(opacity) * LOG2_E, p.z, radius, channels);
}

// Compute d loss / d quat from d loss / d Q, including the normalisation. r[column][row].
fn quat_gradient(q: vec4f, per_length: f32, r: mat3x3f) -> vec4f {
    let by_w = 2.0 * (q.x * (r[1][2] - r[2][1]) + q.y * (r[2][0] - r[0][2]) + q.z * (r[0][1] - r[1][0]));
    let by_x = 2.0 * (
        -2.0 * q.x * (r[1][1] + r[2][2]) + q.y * (r[1][0] + r[0][1]) + q.z * (r[2][0] + r[0][2])
        + q.w * (r[1][2] - r[2][1])
    );
    let by_y = 2.0 * (
        q.x * (r[1][0] + r[0][1]) - 2.0 * q.y * (r[0][0] + r[2][2]) + q.z * (r[2][1] + r[1][2])
        + q.w * (r[2][0] - r[0][2])
    );
    let by_z = 2.0 * (
        q.x * (r[2][0] + r[0][2]) + q.y * (r[2][1] + r[1][2]) - 2.0 * q.z * (r[0][0] + r[1][1])
        + q.w * (r[0][1] - r[1][0])
    );
    let by = vec4f(by_x, by_y, by_z, by_w);
    return (by - dot(by, q) * q) * per_length;
}

struct Gradient {
    splat: array<f32, BY_SPLAT>,
    basis: array<f32, 25>,  // the gradient of coefficient k is basis[k] colour
    color: vec3f,
}

// Compute the gradient of a drawn splat.
fn gradient_of(i: u32) -> Gradient {
    var result: Gradient;
    let first = i * SPLAT;
    let conic = projected[i].conic;
    let at = i * PAIR_SUMS;
    let mean = triple(first);
    let p = to_camera(mean);
    let axes = axes_of(first);
    let e = ellipse_of(p, axes);
    let j = e.jacobian;

    // sums are of g = d loss / d sigma with sigma = d . conic d / 2, and of g e and g e et with e = conic d:
    // d sigma / d mean = -e, and d sigma / d cov = -e et / 2. Sums of e instead of d avoid cancellation for needles.
    let by_log_opacity = -sums[at + G];
    let by_mean2d = -vec2f(sums[at + G_X], sums[at + G_Y]);
    var by_cov = vec3f(-0.5 * sums[at + G_XX], -sums[at + G_XY], -0.5 * sums[at + G_YY]);  // xx, xy (as one), yy
    let half_size = 0.5 * u.size;
    result.splat[12u] = by_mean2d.x * half_size.x;
    result.splat[13u] = by_mean2d.y * half_size.y;
    result.splat[14u] = sums[at + ABS_X] * half_size.x;
    result.splat[15u] = sums[at + ABS_Y] * half_size.y;

    // u and v: xx = u.u, xy = u.v, yy = v.v
    var by_u = 2.0 * by_cov.x * e.u + by_cov.y * e.v;
    var by_v = 2.0 * by_cov.z * e.v + by_cov.y * e.u;
    if (splats[first + 12u] > 0.0) {
        // the opacity has the factor |u x v| / sqrt(det cov)
        let unit = by_log_opacity / dot(e.cross, e.cross);
        let by_det = -0.5 * by_log_opacity * vec3f(conic.x, 2.0 * conic.y, conic.z);
        by_u += cross(e.v, e.cross) * unit + 2.0 * by_det.x * e.u + by_det.y * e.v;
        by_v += cross(e.cross, e.u) * unit + 2.0 * by_det.z * e.v + by_det.y * e.u;
    }
    let m = transpose(axes.turned);
    let m0 = m[0] * axes.scale;
    let m1 = m[1] * axes.scale;
    let m2 = m[2] * axes.scale;
    let by_j = vec4f(dot(by_u, m0), dot(by_u, m2), dot(by_v, m1), dot(by_v, m2));

    // the mean affects its projection fx x/z + cx, and j0 = fx/z and j2 = -fx ratio_x/z,
    let per_z = 1.0 / p.z;
    let ratio = p.xy * per_z;
    let clamped = clamp(ratio, u.low, u.high);
    var by_p = vec3f(by_mean2d * vec2f(j.x, j.z), 0.0);
    by_p.z = -(dot(by_p.xy, p.xy) + dot(by_j, j)) * per_z;
    // where ratio_x = x/z unless it is clamped
    let free = (u.low < ratio) & (ratio < u.high);
    let by_ratio = select(vec2f(0.0), -vec2f(by_j.y * j.x, by_j.w * j.z) * per_z, free);
    by_p += vec3f(by_ratio, -dot(by_ratio, clamped));

    // M = R Q diag(s): d loss / d Q = Rt (d loss / d M) diag(s), and s = exp(log_scale) + min_scale
    let by_m0 = j.x * by_u;
    let by_m1 = j.z * by_v;
    let by_m2 = j.y * by_u + j.w * by_v;
    let by_scale = by_m0 * m[0] + by_m1 * m[1] + by_m2 * m[2];
    let by_log_scale = by_scale * (axes.scale - u.min_scale);
    let by_m = transpose(mat3x3f(by_m0 * axes.scale, by_m1 * axes.scale, by_m2 * axes.scale));
    let by_quat = quat_gradient(axes.quat, axes.per_length, transpose(camera_rotation()) * by_m);

    result.splat[3u] = by_log_opacity * (1.0 - sigmoid(splats[first + 3u]));
    result.splat[4u] = by_quat.w;
    for (var k = 0u; k < 3u; k++) {
        result.splat[5u + k] = by_quat[k];
        result.splat[8u + k] = by_log_scale[k];
    }
    result.splat[11u] = by_log_opacity / splats[first + 11u];

    let gradient = vec3f(sums[at + RED], sums[at + RED + 1u], sums[at + RED + 2u]);
    let channels = vec3u(projected[i].channels) & vec3u(1u, 2u, 4u);
    result.color = select(vec3f(0.0), gradient, channels != vec3u(0u));
    let offset = mean - u.position.xyz;
    let per_length = 1.0 / length(offset);
    let direction = offset * per_length;
    var values: array<f32, 25>;
    basis(direction, u.degree, &values);
    result.basis = values;
    var slopes: array<vec3f, 25>;
    basis_gradient(direction, u.degree, &slopes);
    var by_direction = vec3f(0.0);
    for (var k = 0u; k < active_terms(); k++) {
        let c = (i * u.terms + k) * 3u;
        by_direction += dot(vec3f(sh[c], sh[c + 1u], sh[c + 2u]), result.color) * slopes[k];
    }
    // direction = (mean - position) / length: only the perpendicular component changes it
    let through_colour = (by_direction - dot(by_direction, direction) * direction) * per_length;
    let by_mean = through_colour + transpose(camera_rotation()) * by_p;
    for (var k = 0u; k < 3u; k++) { result.splat[k] = by_mean[k]; }
    return result;
}

fn active_terms() -> u32 {
    return (u.degree + 1u) * (u.degree + 1u);
}

// Write the gradients of drawn splats; those of other splats stay zero.
@compute @workgroup_size(LANES)
fn backward(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let i = group_of(group) * LANES + lane;
    if (i >= u.count || projected[i].radius == 0.0) { return; }
    var gradient = gradient_of(i);
    for (var k = 0u; k < BY_SPLAT; k++) { by_splats[i * BY_SPLAT + k] = gradient.splat[k]; }
    for (var k = 0u; k < active_terms(); k++) {
        let c = (i * u.terms + k) * 3u;
        for (var channel = 0u; channel < 3u; channel++) {
            by_sh[c + channel] = gradient.basis[k] * gradient.color[channel];
        }
    }
}

// Collect the statistics of density control.
fn collect_stats(i: u32, gradient: ptr<function, Gradient>) {
    let norm = length(vec2f((*gradient).splat[BY_MEAN2D], (*gradient).splat[BY_MEAN2D + 1u])) / u.shrink;
    let at = i * STATS;
    stats[at + GRADIENT_SUM] += norm;
    stats[at + SEEN] += 1.0;
    stats[at + GRADIENT_MAX] = max(stats[at + GRADIENT_MAX], norm);
    stats[at + RADIUS_MAX] = max(stats[at + RADIUS_MAX], projected[i].radius);
    stats[at + OPACITY_SUM] += sigmoid(splats[i * SPLAT + LOGIT]);
}

// Make an Adam step (Kingma and Ba 2015, Algorithm 1) of number j of a splat; return the difference of its value.
fn adam(i: u32, j: u32, g: f32) -> f32 {
    let at = i * (TRAINED + 3u * u.terms) + j;
    let previous = moments[at];
    var m = u.keep_m * previous.x + (1.0 - u.keep_m) * g;
    var v = u.keep_v * previous.y + (1.0 - u.keep_v) * (g * g);
    m = select(0.0, m, abs(m) > M_TINY);
    v = select(0.0, v, v > V_TINY);
    moments[at] = vec2f(m, v);
    let pair = u.rates[j / 2u];
    let rate = select(pair.xy, pair.zw, j % 2u == 1u);
    return rate.x * m / (sqrt(v * rate.y) + u.eps);
}

// Test if a step changes a splat.
fn is_trained(i: u32) -> bool {
    return u.drawn_only == 0.0 || splats[i * SPLAT + WEIGHT] > 0.0;
}

// Train the splats of a workgroup. First each invocation computes the gradient of one splat, then each changes single
// numbers. Splats that were not drawn have zero gradients. A step that had too many pairs changes nothing.
@compute @workgroup_size(LANES)
fn train(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
    let first = group_of(group) * LANES;
    let i = first + lane;
    let fits = report[NEEDED] == 0u;
    var gradient: Gradient;  // zero
    if (i < u.count && projected[i].radius > 0.0) {
        gradient = gradient_of(i);
        if (fits && u.shrink > 0.0) { collect_stats(i, &gradient); }
    }
    for (var k = 0u; k < TRAINED; k++) { splat_gradients[lane * TRAINED + k] = gradient.splat[k]; }
    for (var k = 0u; k < active_terms(); k++) { bases[lane * 25u + k] = gradient.basis[k]; }
    colour_gradients[lane] = gradient.color;
    workgroupBarrier();
    if (!fits) { return; }
    let count = min(LANES, u.count - first);
    for (var k = lane; k < count * TRAINED; k += LANES) {
        let row = k / TRAINED;
        let j = k % TRAINED;
        if (is_trained(first + row)) {
            splats[(first + row) * SPLAT + j] -= adam(first + row, j, splat_gradients[k]);
        }
    }
    let width = 3u * u.terms;
    for (var k = lane; k < count * width; k += LANES) {
        let row = k / width;
        let j = k % width;
        let term = j / 3u;
        var g = 0.0;
        if (term < active_terms()) { g = bases[row * 25u + term] * colour_gradients[row][j % 3u]; }
        let drawn = u.sparse_sh == 0.0 || projected[first + row].radius > 0.0;
        if (drawn && is_trained(first + row)) { sh[first * width + k] -= adam(first + row, TRAINED + j, g); }
    }
}
