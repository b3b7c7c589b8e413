// Shared by all shaders.

const LANES: u32 = 64;
const TILE: u32 = 16;

// A splat projected to an ellipse: log2 alpha = log2_opacity - LOG2_E / 2 (d . conic d), with d = pixel - mean.
struct Row {
    mean: vec2f,  // in pixels
    half_size: vec2f,  // of the bounding box of the ellipse alpha = ALPHA_MIN
    conic: vec3f,  // xx, xy and yy of the inverse covariance
    log2_opacity: f32,
    depth: f32,  // along the camera's z axis
    radius: f32,  // three standard deviations along the longest axis; 0 if not drawn
    channels: u32,  // bit mask of the colour channels above zero
}

// Test if the ellipse alpha = ALPHA_MIN intersects the rectangle of pixel centres from first to first + span.
// The quadratic form is convex. If the mean is outside the rectangle, the minimum is on an edge that faces it.
fn touches(row: Row, first: vec2f, span: vec2f) -> bool {
    let low = first - row.mean;
    let high = low + span;
    let outside_x = low.x > 0.0 || high.x < 0.0;
    let outside_y = low.y > 0.0 || high.y < 0.0;
    let a = row.conic.x;
    let b = row.conic.y;
    let c = row.conic.z;
    let reach = 2.0 * LN2 * (row.log2_opacity - LOG2_ALPHA_MIN);
    var intersects = !outside_x && !outside_y;
    if (outside_x) {
        let dx = select(high.x, low.x, low.x > 0.0);
        let dy = clamp(-b * dx / c, low.y, high.y);
        intersects = intersects || (a * dx + 2.0 * b * dy) * dx + c * dy * dy <= reach;
    }
    if (outside_y) {
        let dy = select(high.y, low.y, low.y > 0.0);
        let dx = clamp(-b * dy / a, low.x, high.x);
        intersects = intersects || (a * dx + 2.0 * b * dy) * dx + c * dy * dy <= reach;
    }
    return intersects;
}

// Work is dispatched in chunks; this is the index of the chunk's first workgroup.
@group(0) @binding(15) var<uniform> first_group: u32;

fn group_of(group: vec3u) -> u32 {
    return first_group + group.x;
}

// Columns of the sums per splat of blending's backward pass, with sigma = -ln(alpha / opacity), g = d loss / d sigma
// and e = conic d: g, g e, g e et, and the sums over pixels of |g e|.
const G: u32 = 0;
const G_X: u32 = 1;
const G_Y: u32 = 2;
const G_XX: u32 = 3;
const G_XY: u32 = 4;
const G_YY: u32 = 5;
const ABS_X: u32 = 6;
const ABS_Y: u32 = 7;
const RED: u32 = 8;  // d loss / d colour
const PAIR_SUMS: u32 = 11;

// Columns of the report of training steps, before their losses.
const NEEDED: u32 = 0;  // number of pairs of the first step that had too many; zero without one
const COMPLETED: u32 = 1;  // number of steps before it
