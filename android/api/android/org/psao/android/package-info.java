/**
 * What only Android has, for {@link org.psao}: recordings among an app's assets, activities that
 * pause, networks that change. Needs API 24.
 */
package org.psao.android;
